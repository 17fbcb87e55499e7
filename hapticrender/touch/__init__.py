"""What is touched, and by what."""
