"""Where tactile content comes from: files, pictures, text, the paper's six experiments."""
