"""Who may do what: roles, enrolment, tokens."""
