"""Pages that show a material or a BTF, whole in one file."""
