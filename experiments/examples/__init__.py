"""Short scripts that each end in a picture, and the notebooks made of them."""
