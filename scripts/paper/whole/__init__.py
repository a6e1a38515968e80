"""All tables and figures of the paper in one resumable run, with one page and one JSON of what came of it."""
