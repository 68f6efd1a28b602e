"""Everything that reads or writes parameters."""
