"""What the motion determines and what it leaves free."""
