"""The native store `*.btf.zarr`: its reader and its writer."""
