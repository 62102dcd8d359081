"""Preview process: builds the sequences of all pushes and plans dry runs, each within limits of time and memory."""
