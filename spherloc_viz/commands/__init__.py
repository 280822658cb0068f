"""What the command line does: ``cli`` and ``of_*`` say what each command takes, the other modules do it."""
