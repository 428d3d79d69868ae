"""Plants made to hide from a record what a loop meets, and ordinary ones beside them. One file, one
fault."""
