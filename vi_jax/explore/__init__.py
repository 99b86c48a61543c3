"""A page with sliders and immediate pictures of motions: `vi-jax explore`."""
