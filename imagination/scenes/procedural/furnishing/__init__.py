"""Furnishing: selection and placement of furniture in rooms."""
