"""How good and how fast each step is, beside others' in the same run (``python -m sitl bench``)."""
