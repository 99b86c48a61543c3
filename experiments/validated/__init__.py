"""Published examples of other codes, each computed again in a short script and compared."""
