"""From the content of an upload and the registered markers near it to its result, without database and files."""
