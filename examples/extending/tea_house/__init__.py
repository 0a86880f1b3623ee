"""Parts of scenes, of training and of search, each in one file."""
