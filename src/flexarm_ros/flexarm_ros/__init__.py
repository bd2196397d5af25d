"""What the nodes share: parameters, life cycle, quality of service, messages to arrays and back."""
