"""Parts of the longer studies: what they measure and draw, so that a study itself is a page."""
