"""The commands of ``python -m sitl``; what each needs is imported once it runs."""
