"""What DJI drones and their apps write beside stills: subtitles, flight tables, encrypted records."""
