"""Page of the viewer: HTML, style and scripts, joined into one file by :mod:`scene_envs.render.viewer`."""
