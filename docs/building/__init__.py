"""What makes those parts of the guide that nobody writes by hand. Sphinx loads these modules as extensions."""
