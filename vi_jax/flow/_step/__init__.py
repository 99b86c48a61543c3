"""One step of the loop: an attempt, the events in it, landing on the first, what comes of it."""
