"""An episode as a web page and as a GIF."""
