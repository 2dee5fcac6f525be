"""Parts of a page that need a server: how it is doing, and where its robots are."""
