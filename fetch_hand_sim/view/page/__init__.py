"""What is drawn in the browser, and what the mouse and the keys do there."""
