"""What happened: kept, judged, and written in the formats of others."""
