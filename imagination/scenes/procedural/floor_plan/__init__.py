"""Floor plans and the building around them."""
