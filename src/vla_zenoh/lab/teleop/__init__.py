"""An arm driven by hand: keys and sticks to wishes, wishes to the action steps of a worker."""
