"""The command group `optodrive calibrate`, with one module per subcommand."""
