"""Plain complex controllers, for comparison."""
