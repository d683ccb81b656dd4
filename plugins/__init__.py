"""What not every skin needs: parts that the core finds by entry points and never imports."""
