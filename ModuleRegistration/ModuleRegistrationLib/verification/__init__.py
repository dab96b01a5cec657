"""What a registration is worth, shown with data it has not seen: TRE, plausibility, studies, report."""
