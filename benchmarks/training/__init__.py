"""What is trained: coefficients in the code, each with the command that finds it again."""
