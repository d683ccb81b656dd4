"""What bridges cost, and what they cost the graph beside them."""
