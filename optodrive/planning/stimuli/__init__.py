"""Sources of tactile content: sequence files, images, text, shapes and the paper's six experiments."""
