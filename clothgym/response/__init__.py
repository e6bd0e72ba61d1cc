"""What happens to detected pairs: contact, untangling."""
