"""The page that shows a drive and can stop it."""
