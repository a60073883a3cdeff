"""Thousands of simulated runs on all cores or machines: sweeps over settings, and tuning."""
