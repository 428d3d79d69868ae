"""Table of a study, gathered from its runs, filtered, sorted and printed."""
