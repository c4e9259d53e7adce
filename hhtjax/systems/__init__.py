"""What is simulated, and what a stepper sees of it: systems, initial values, constraints, rotations, inputs."""
