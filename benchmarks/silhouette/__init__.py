"""Protocol Silhouette: whole bodies tracked from silhouettes of several cameras, three filters."""
