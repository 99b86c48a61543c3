"""A page with sliders on which motions are seen at once: `vi-jax explore`."""
