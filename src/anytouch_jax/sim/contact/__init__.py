"""Contact mechanics of a soft gel."""
