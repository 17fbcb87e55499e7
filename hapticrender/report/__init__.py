"""Pictures, pages and tables about recordings."""
