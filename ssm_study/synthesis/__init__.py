"""Design of controllers and observers with certificates, verified in exact arithmetic."""
