"""Certificates and probabilities against exact references."""
