"""What each sensor records of a contact."""
