"""`torture`: killing, corrupting, poisoning and racing the program, for real, and counting what it lost or let in."""
