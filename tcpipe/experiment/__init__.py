"""The paper's experiment on a simulated site: simulate, build, train, evaluate, and check the paper's claims."""
