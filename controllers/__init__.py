"""What moves the shepherds."""
