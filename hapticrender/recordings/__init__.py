"""Recordings: written while a run happens, judged, and read and written in several formats."""
