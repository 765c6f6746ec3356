"""What the versions of FMI have in common: statuses, messages, and the chain rule of systems."""
