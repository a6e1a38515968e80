"""Where to touch: contacts under the shape's uncertainty, with a certificate of closure."""
