"""whitefurnace: integrates BRDFs on OpenCL devices and bakes image-based lighting with a stated error."""
