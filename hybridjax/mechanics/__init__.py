"""Equations of motion of mechanisms, from their energies."""
