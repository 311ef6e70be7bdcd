"""Complete experiments as TOML; a bare name on the command line is one of these."""
