"""The benchmark: the same drives for every driver, and their score; LEADERBOARD.md has the rules."""
