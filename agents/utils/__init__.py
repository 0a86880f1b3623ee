"""Helpers that several subpackages of ``agents`` share; import them from the module that defines them."""
