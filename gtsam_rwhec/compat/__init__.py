"""Calls with other libraries' names, argument orders and conventions, for programs that change one import."""
