"""``python -m vcl_companion``, for who has the package and not its script."""

from vcl_companion.cli import main

main(prog_name="vcl")
