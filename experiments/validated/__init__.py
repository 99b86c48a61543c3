"""Examples of other codes, each computed again in a short script beside their own numbers."""
