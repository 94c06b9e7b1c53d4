"""From demonstrations of one Meta-World task to a policy and its table, in steps that resume."""
