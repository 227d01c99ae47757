"""Accuracy against cost of the choices that the framework offers."""
