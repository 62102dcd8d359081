"""How bytes reach a board: serial ports, and whatever else the registry names."""
