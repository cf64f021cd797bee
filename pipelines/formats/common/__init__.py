"""Code that formats of several kinds share: times and numbers as text, names of files, extras."""
