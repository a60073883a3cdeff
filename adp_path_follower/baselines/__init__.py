"""The peers that the controller is compared with, behind the same interface (`registry.PEERS`)."""
