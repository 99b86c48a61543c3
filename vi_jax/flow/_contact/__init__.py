"""What happens on stops: impacts, coming to rest, release."""
