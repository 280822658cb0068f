"""What is solved and how: the widgets of the tab Play, and the steps."""
