"""The `anytouch` command line: one file a command."""
