"""The supervisor: starts, watches and ends the processes of the daemon."""
