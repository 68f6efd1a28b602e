"""Data sets: readers of public ones and recordings, checks, captions and shards."""
