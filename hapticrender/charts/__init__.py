"""Pictures for people, and the data behind them."""
