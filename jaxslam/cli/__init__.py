"""The command line: `main` has the application, `run`, `learn` and `images` the larger commands."""
