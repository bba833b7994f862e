"""Mechanizations: each a start from geodetic terms and an `advance` kernel that answers in them; joined in `nav.strapdown`."""
