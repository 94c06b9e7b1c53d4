"""Two other makers' robots on one bus: a policy obeyed, one in shadow, a cut link, an agent."""
