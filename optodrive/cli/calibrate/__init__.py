"""`optodrive calibrate`: one module per subcommand."""
