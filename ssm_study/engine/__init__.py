"""Engine that runs one task many times with different settings. It computes stages once, keeps a
record of every run, and starts the jobs as processes or through a launcher; it knows no science."""
