"""Aided navigation: an error-state Kalman filter beside the mechanizations, its measurements, and what joins them."""
