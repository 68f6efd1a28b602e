"""Commands of the `anytouch` command line: one file each, with its options and its `run`."""
