"""How the server is doing: in figures for clients, and for programs that watch it over HTTP."""
