"""Single matches: the card, the table and the images."""
