"""What a pose and a camera are; numpy only."""
