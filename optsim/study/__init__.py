"""Lists of experiments that differ in a parameter, and the tables that they make."""
