"""A map in the browser, as it grows: pages of viser, fed by an ordinary client."""
