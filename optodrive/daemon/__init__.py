"""The daemon: the engine that joins the stages, and its REST interface."""
