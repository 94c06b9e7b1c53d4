"""Makes the certificates of a lab, and the profile that uses them."""
