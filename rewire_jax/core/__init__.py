"""What every room uses: settings, errors, formatting, the compilation cache."""
