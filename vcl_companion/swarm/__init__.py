"""Who is in the group and who does what, and how blobs get across; no socket, no clock."""
