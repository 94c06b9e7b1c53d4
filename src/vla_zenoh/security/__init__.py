"""Who may say what: certificates, roles, and rules for the router. Pure."""
