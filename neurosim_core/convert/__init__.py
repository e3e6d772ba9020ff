"""Videos and folders of pictures as events; `convert.convert_video` does it."""
