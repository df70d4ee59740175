"""Objects in calibrated pictures: locators, what they share, and the tools that show them."""
