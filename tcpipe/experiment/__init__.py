"""The paper's experiment on a simulated site: `reproduction.reproduce` simulates, builds, trains, evaluates and checks the paper's claims."""
