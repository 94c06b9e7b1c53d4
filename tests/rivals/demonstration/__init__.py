"""Two robots of others on one bus: a policy obeyed, one in shadow, a cut link, an agent."""
