"""Pretraining of scene priors on datasets or on a grammar."""
