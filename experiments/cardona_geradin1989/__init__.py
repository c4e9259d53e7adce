"""Cardona and Geradin (1989): constraints and rotations, reproduced and carried on."""
