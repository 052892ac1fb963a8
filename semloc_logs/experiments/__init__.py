"""The experiments of the paper (section 4): scenarios, systems, answers, figures."""
