"""The simulated town measured as other people measured roads, by matchers that are not ours."""
