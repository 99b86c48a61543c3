"""One step of the loop: an attempt, the search for its first event, and the effects of that."""
