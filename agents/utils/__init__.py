"""Helpers that several rooms of agents share; import the module that has them."""
