"""Observers: what reconstructs the rates of the deflections. One observer per file."""
