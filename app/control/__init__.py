"""What an operator does on the server's machine, carried out by the running server or by the command itself."""
