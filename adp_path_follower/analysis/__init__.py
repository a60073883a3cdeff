"""Figures and numbers of runs."""
