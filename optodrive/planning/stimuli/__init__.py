"""Sources of tactile content such as sequence files, images, text, shapes and the paper's six experiments."""
